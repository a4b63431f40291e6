"""What the stages are worth: accuracy on rebuilt scenes, and speed against peers."""
