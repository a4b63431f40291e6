"""Control of a robot from a terminal, by keys and by a gamepad."""
