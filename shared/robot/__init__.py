"""Describe robots: profiles, kinematics, stability and cameras."""
