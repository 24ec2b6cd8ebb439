"""Check a data set of demonstrations without a model of the robot."""
