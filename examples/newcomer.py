"""From CSV files to a model in ONNX: ``python newcomer.py FOLDER``.

The folder holds files ``MATERIAL_LABEL_*.csv``, each a recording of one label (``slip`` or another
word): a header, a row an instant, a column a channel, 2000 rows a second.
"""

import sys
from pathlib import Path

import numpy as np
import onnxruntime
from sklearn.model_selection import LeaveOneGroupOut, cross_val_score

from tactslip_torch import SlipClassifier

folder = Path(sys.argv[1])
X, y, materials = [], [], []
for path in sorted(folder.glob("*.csv")):
    material, label, *_ = path.stem.split("_")
    samples = np.loadtxt(path, delimiter=",", skiprows=1).T  # channels, time
    windows = np.lib.stride_tricks.sliding_window_view(samples, 100, axis=1)[:, ::100]
    X += list(windows.swapaxes(0, 1))
    y += [label] * windows.shape[1]
    materials += [material] * windows.shape[1]
X = np.stack(X)  # windows, channels, 50 ms of samples

classifier = SlipClassifier(sample_rate_hz=2000)
scores = cross_val_score(classifier, X, y, groups=materials, cv=LeaveOneGroupOut())
print(f"materials left out: {scores.mean():.3f}")
classifier.fit(X, y, materials).save(folder / "slip.pt")
model, *_ = SlipClassifier.load(folder / "slip.pt").export_onnx(folder)
session = onnxruntime.InferenceSession(model)
score, valid = session.run(["score", "valid"], {"samples": X.astype(np.float32)})
print(f"ONNX: {(valid & (score >= 0)).sum()} of {len(X)} windows are slip")
