"""Register depth frames: keyframes, projective ICP, relocalization and the motion prior."""
