"""What reading and writing a recording costs in every format."""
