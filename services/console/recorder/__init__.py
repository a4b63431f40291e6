"""The recorder: a process of its own, so that neither the robot nor the page ever waits for a disk."""
