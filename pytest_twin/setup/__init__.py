"""Create a twin for a robot's model file."""
