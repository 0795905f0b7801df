"""What alarms cost and buy: hops and filters as a front, and other methods at equal terms."""
