"""Live runs over Zenoh with services as processes, and orders to a running robot."""
