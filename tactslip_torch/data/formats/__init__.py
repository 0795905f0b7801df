"""Files of recordings: ours, and those that people have; a module a format, one registry."""
