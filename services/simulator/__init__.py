"""Owns MuJoCo: world, terrains, depth camera and servo-bus emulator; on the wire it is a camera and a bus."""
