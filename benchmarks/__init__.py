"""What is timed, and the scripts that print the tables; run from a checkout, not installed."""
