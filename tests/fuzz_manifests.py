"""Harmful manifests: ways out of the folder, objects, what nests and multiplies."""

_HEAD = b"file,material\n"
MANIFEST_TRAPS: dict[str, tuple[str, bytes]] = {
    **{
        file: ("manifest.csv", _HEAD + f"{file},M1\n".encode())
        for file in (
            "../outside.csv",
            "sub/../../outside.csv",
            "..\\outside.csv",
            "/etc/passwd",
            "C:\\outside.csv",
            "\\\\host\\share\\a.csv",
            "//host/a.csv",
            "link.csv",
            "circle.csv",
            "a.csv\0",
            "~/a.csv",
            "$HOME/a.csv",
            "file:///etc/passwd",
            "a" * 5000,
            "/".join("a" * 3000),
            "",
        )
    },
    "twice": ("manifest.csv", _HEAD + b"a.csv,M1\na.csv,M1\n" * 2000),
    "long line": ("manifest.csv", _HEAD + b"a" * 2**22 + b",M1\n"),
    "open quote": ("manifest.csv", _HEAD + b'"a.csv,M1\n' * 50_000),
    "many columns": ("manifest.csv", b"file,material" + b",x" * 2000 + b"\na.csv,M1\n"),
    "many stretches": (
        "manifest.csv",
        b"file;material;sliding_s\na.csv;M1;" + b"3-1, " * 20_000 + b"\n",
    ),
    "deep cell": ("manifest.csv", b"file;material;onsets_s\na.csv;M1;" + b"[" * 100_000 + b"\n"),
    "long number": ("manifest.csv", b"file;material;onsets_s\na.csv;M1;" + b"9" * 100_000 + b"\n"),
    "long integer": ("manifest.csv", b"file,material,trial\na.csv,M1," + b"9" * 100_000 + b"\n"),
    "NULs": ("manifest.csv", bytes(100_000)),
    "binary": ("manifest.csv", bytes(range(256)) * 100),
    "UTF-16": ("manifest.csv", "file,material\na.csv,M1\n".encode("utf-16")),
    "object": ("manifest.yaml", b"- !!python/object/apply:os.mkdir [CANARY]\n"),
    "object in a cell": (
        "manifest.yaml",
        b"- file: !!python/object/apply:os.mkdir [CANARY]\n  material: a\n",
    ),
    "object for a key": ("manifest.yaml", b"- ? !!python/name:os.mkdir\n  : a\n"),
    "laughs": (
        "manifest.yaml",
        b"- &a0 [x, x]\n"
        + b"".join(b"- &a%d [*a%d, *a%d]\n" % (i, i - 1, i - 1) for i in range(1, 60)),
    ),
    "merge": ("manifest.yaml", b"- &a {file: a.csv}\n- {<<: *a, material: M1}\n"),
    "nested lists": ("manifest.yaml", b"[" * 50_000),
    "nested mappings": ("manifest.yaml", b"{a: " * 50_000),
    "nested blocks": ("manifest.yaml", b"- " * 50_000),
    "nested cell": (
        "manifest.yaml",
        b"- {file: a.csv, material: M1, onsets_s: " + b"[" * 400 + b"]" * 400 + b"}",
    ),
    "documents": ("manifest.yaml", b"--- 1\n" * 5000),
    "mapping in a cell": ("manifest.yaml", b"- {file: {a: b}, material: M1}\n"),
    "link in YAML": ("manifest.yaml", b"- {file: link.csv, material: M1}\n"),
    "YAML NUL": ("manifest.yaml", b'- {file: "a.csv\\0", material: M1}\n'),
    "large YAML": ("manifest.yaml", b"- {file: a.csv, material: M1}\n" * 2**20),
    "other ending": ("manifest.txt", _HEAD + b"a.csv,M1\n"),
}
