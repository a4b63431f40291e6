"""Maps of ground that is known as a whole, with the layers that the mapper computes."""
