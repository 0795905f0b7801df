"""Packed bytes, unpacked to no more than was stated and no more than is sensible."""

from __future__ import annotations

from tactslip_torch.data.formats.reading import needs

MOST_BYTES = 256 * 2**20
"""Of a chunk or message, packed or not; writers make chunks of about 1 MiB."""


def expand(packing: str, packed: bytes, size: int) -> bytes:
    """Bytes that were packed by ``zstd``, ``lz4`` or, if that is empty, not at all.

    Raises:
        ValueError: if they do not unpack to ``size``, that is more than ``MOST_BYTES``, or the
            packing is none of these.
    """
    if size > MOST_BYTES:
        raise ValueError(f"a chunk of {size} bytes, at most {MOST_BYTES} are read")
    if packing == "zstd":
        content = _from_zstd(packed, size)
    elif packing == "lz4":
        content = _from_lz4(packed, size)
    elif packing == "":
        content = packed
    else:
        raise ValueError(f"packed by {packing!r}; zstd, lz4 and nothing are read")
    if len(content) != size:
        raise ValueError(f"damaged: {len(content)} bytes in a chunk of {size}")
    return content


def expand_message(packed: bytes) -> bytes:
    """A message that was packed by ``zstd``, which states its size.

    Raises:
        ValueError: as ``expand``, or if it states none.
    """
    zstandard = needs("zstandard", "reading messages packed by zstd")
    try:
        size = zstandard.frame_content_size(packed)
    except zstandard.ZstdError:
        raise ValueError("damaged: a message that does not unpack") from None
    if size < 0:
        raise ValueError("damaged: a packed message that does not state its size")
    return expand("zstd", packed, size)


def _from_zstd(packed: bytes, size: int) -> bytes:
    zstandard = needs("zstandard", "reading messages packed by zstd")
    try:
        stated = zstandard.frame_content_size(packed)  # the library would allocate this much
        if stated not in (size, -1):
            raise ValueError(f"damaged: a chunk of {size} bytes that unpacks to {stated}")
        if size == 0:
            return b""
        content: bytes = zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)
    except zstandard.ZstdError:
        raise ValueError("damaged: a chunk that does not unpack") from None
    return content


def _from_lz4(packed: bytes, size: int) -> bytes:
    frame = needs("lz4.frame", "reading messages packed by lz4")
    try:
        content: bytes = frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
    except RuntimeError:
        raise ValueError("damaged: a chunk that does not unpack") from None
    return content
