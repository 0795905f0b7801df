"""What must stay true while everything behind the public names and commands is rearranged."""
