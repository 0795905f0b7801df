"""Which sensors matter: by gradient, by leaving them out, and by making do with the best few."""
