"""What a robot's file says, held against what a robot can be: one file per layer of the asset."""
