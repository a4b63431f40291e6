"""Router hosting, access control, and discovery of the machines of a robot."""
