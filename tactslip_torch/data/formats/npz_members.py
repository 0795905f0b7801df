"""Which members of an archive may be unpacked: no bombs, nothing that NumPy does not write."""

from __future__ import annotations

import os
import zipfile

from tactslip_torch.data.formats.refusing import Refused

MOST_CHANNELS = 2**16
_MOST_RATIO = 100  # of bytes unpacked to bytes packed
_FREE_BYTES = 64 * 2**20  # that anything may unpack to
_MOST_BESIDE = 16 * 2**20  # bytes of a member that is read whole: names, numbers, JSON
_SAMPLES = "samples.npy"
_ENCRYPTED = 1


def check_members(archive: zipfile.ZipFile, path: str | os.PathLike[str]) -> None:
    """Refuse an archive whose members claim more than can be meant, before any is unpacked.

    Raises:
        Refused: if a member is packed by anything but deflate, is encrypted, or unpacks to more
            than 64 MiB and 100 times its packed bytes; or if one beside the samples of a file of
            ours has more than 16 MiB.
    """
    is_ours = "format.npy" in archive.namelist()
    for member in archive.infolist():
        name, size = member.filename[:40], member.file_size
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise Refused(f"{os.fspath(path)}: {name!r} is not packed as NumPy packs arrays")
        if member.flag_bits & _ENCRYPTED:
            raise Refused(f"{os.fspath(path)}: {name!r} is encrypted; write it in the clear")
        if size > max(_FREE_BYTES, _MOST_RATIO * member.compress_size):
            raise Refused(
                f"{os.fspath(path)}: {name!r} of {member.compress_size} bytes claims to unpack to "
                f"{size}, more than {_MOST_RATIO} times that; write it without compression"
            )
        if is_ours and member.filename != _SAMPLES and size > _MOST_BESIDE:
            raise Refused(f"{os.fspath(path)}: {name!r} has {size} bytes, at most {_MOST_BESIDE}")
