"""A ROS 2 node without ROS: CDR messages over rmw_zenoh. See docs/ros2.md.

It publishes Sextant's state and subscribes to velocities.
"""
