"""What guards cost: features and scores with them and with plain formulas in their place."""
