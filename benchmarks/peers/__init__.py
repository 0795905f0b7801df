"""What else there is to make features and scores with; nothing in here imports the package.

``loop`` is the obvious SciPy and PyWavelets loop, ``arrays`` the same features in batched NumPy;
both agree with ``FeaturePool``. ``others`` make other features: TSFEL, MiniRocket,
and MultiRocket with Hydra.
"""
