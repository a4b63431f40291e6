"""Plans on whole maps, without a robot."""
