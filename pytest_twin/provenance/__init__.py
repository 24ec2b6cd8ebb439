"""What a stamped data set was made with, and what has changed in the twin since."""
