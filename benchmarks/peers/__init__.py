"""Speed and accuracy compared with other implementations, given the same input."""
