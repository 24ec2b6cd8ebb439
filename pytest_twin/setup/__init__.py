"""From a robot's file to a working twin."""
