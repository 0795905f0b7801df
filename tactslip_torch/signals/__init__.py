"""From raw channels to what features are taken from: filter, bins, wavelet branches, spectra."""
