"""What of ``newcomer.py`` TSFEL and scikit-learn do: features, score, saved model; no ONNX."""

import sys
from pathlib import Path

import joblib
import numpy as np
import pandas as pd
import tsfel
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import LeaveOneGroupOut, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

folder = Path(sys.argv[1])
config = tsfel.get_features_by_domain(["statistical", "temporal", "spectral"])
tables, y, materials = [], [], []
for path in sorted(folder.glob("*.csv")):
    material, label, *_ = path.stem.split("_")
    recording = pd.read_csv(path)
    table = tsfel.time_series_features_extractor(
        config, recording, fs=2000, window_size=100, verbose=0, n_jobs=None
    )
    tables.append(table)
    y += [label] * len(table)
    materials += [material] * len(table)
X = pd.concat(tables).fillna(0.0).to_numpy()

classifier = make_pipeline(StandardScaler(), LogisticRegression(max_iter=1000))
scores = cross_val_score(classifier, X, y, groups=materials, cv=LeaveOneGroupOut())
print(f"materials left out: {scores.mean():.3f}")
joblib.dump(classifier.fit(X, y), folder / "slip.joblib")
predicted = joblib.load(folder / "slip.joblib").predict(X)
print(f"scikit-learn: {np.sum(predicted == 'slip')} of {len(X)} windows are slip")
