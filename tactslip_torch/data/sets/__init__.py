"""Sets of files as a source: manifests and names, looked at as a whole, on an even clock."""
