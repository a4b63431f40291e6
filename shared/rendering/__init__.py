"""Software rendering: the z-buffer of the simulated cameras and of the video."""
