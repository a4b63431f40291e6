"""Depth registration: keyframes, projective ICP, relocalization and motion prior."""
