"""Settings learned by gradient through the closed-form fit."""
