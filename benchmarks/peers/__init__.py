"""What else there is to make features and scores with; nothing in here imports the package.

``loop`` is the obvious SciPy and PyWavelets loop, ``arrays`` the same features in batched NumPy,
in the slow way or the quick one of ``hard``; all three agree with ``FeaturePool``. ``others`` are
tools that make other features, ``heads`` those of scikit-learn.
"""
