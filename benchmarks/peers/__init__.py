"""What else there is to make features and scores with; nothing in here imports the package.

``arrays`` makes the features of ``FeaturePool`` in batched NumPy and PyWavelets and agrees with it,
``others`` makes other features: TSFEL, MiniRocket, and MultiRocket with Hydra.
"""
