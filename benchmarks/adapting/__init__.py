"""How much of a new material a few recordings bring, and what the old ones pay."""
