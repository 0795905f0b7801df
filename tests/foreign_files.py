"""Arrays and text in files as other people's programs write them."""

import h5py
import numpy as np
import scipy.io

LVM = (
    "LabVIEW Measurement\t\nSeparator\tTab\nDecimal_Separator\t{point}\nX_Columns\t{x}\n"
    "***End_of_Header***\t\n\t\nChannels\t2\t\nSamples\t3\t3\t\nDate\t2012/06/01\t2012/06/01\t\n"
    "X_Dimension\tTime\tTime\t\nDelta_X\t0{point}500000\t0{point}500000\t\n"
    "***End_of_Header***\t\t\t\nX_Value\tUntitled\tUntitled 1\tComment\n"
)


def made_hdf5(path, **datasets):
    with h5py.File(path, "w") as file:
        for name, values in datasets.items():
            file.create_dataset(name, data=values, compression="gzip" if np.ndim(values) else None)
    return path


def made_73(path, **variables):
    """As MATLAB writes it: rows and columns turned, classes marked, characters as numbers."""
    kinds = {"f8": "double", "f4": "single", "i2": "int16", "b1": "logical"}
    with h5py.File(path, "w", userblock_size=512) as file:

        def put(name, values):
            if isinstance(values, str | list):
                words = [values] if isinstance(values, str) else values
                rows = [word.ljust(max(map(len, words))).encode("utf-16-le") for word in words]
                codes = np.stack([np.frombuffer(row, "<u2") for row in rows], 1)
                kept, kind = file.create_dataset(name, data=codes), "char"
            else:
                kept = file.create_dataset(name, data=np.atleast_2d(values).T)
                kind = kinds[np.atleast_2d(values).dtype.str[1:]]
            kept.attrs["MATLAB_class"] = np.bytes_(kind)
            return kept

        for name, values in variables.items():
            put(name, values)
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")
    return path


def stored(path, **content):
    """The same content as any format of arrays has it; a stroke in a name is a group."""
    if path.suffix == ".npz":
        np.savez(path, **content)
    elif path.suffix == ".h5":
        made_hdf5(path, **content)
    elif path.name == "73.mat":
        made_73(path, **content)
    else:
        whole = {}
        for name, values in content.items():
            *groups, leaf = name.split("/")
            place = whole
            for group in groups:
                place = place.setdefault(group, {})
            place[leaf] = np.array(values, "O") if isinstance(values, list) else values
        scipy.io.savemat(path, whole, do_compression=path.stem == "packed")
    return path
