"""What a robot's file says, compared with what a robot can be: one file per layer of the asset."""
