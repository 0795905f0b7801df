"""Dead sensors: what the expected score in closed form keeps, beside what is usually filled in."""
