"""What of ``newcomer.py`` aeon does: windows, score, saved model; no ONNX."""

import sys
from pathlib import Path

import joblib
import numpy as np
from aeon.classification.convolution_based import MiniRocketClassifier
from sklearn.model_selection import LeaveOneGroupOut, cross_val_score

folder = Path(sys.argv[1])
X, y, materials = [], [], []
for path in sorted(folder.glob("*.csv")):
    material, label, *_ = path.stem.split("_")
    samples = np.loadtxt(path, delimiter=",", skiprows=1).T  # channels, time
    windows = np.lib.stride_tricks.sliding_window_view(samples, 100, axis=1)[:, ::100]
    X += list(windows.swapaxes(0, 1))
    y += [label] * windows.shape[1]
    materials += [material] * windows.shape[1]
X, y = np.stack(X), np.array(y)

classifier = MiniRocketClassifier(random_state=0)
scores = cross_val_score(classifier, X, y, groups=materials, cv=LeaveOneGroupOut())
print(f"materials left out: {scores.mean():.3f}")
joblib.dump(classifier.fit(X, y), folder / "slip.joblib")
predicted = joblib.load(folder / "slip.joblib").predict(X)
print(f"aeon: {np.sum(predicted == 'slip')} of {len(X)} windows are slip")
