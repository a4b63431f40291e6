"""Terminal output, argument parsing, interrupts and progress."""
