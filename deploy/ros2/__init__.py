"""A ROS 2 node without ROS: what Sextant says in CDR on the keys of rmw_zenoh, and velocities from there. See docs/ros2.md."""
