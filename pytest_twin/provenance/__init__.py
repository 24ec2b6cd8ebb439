"""Compare the twin that a stamped data set was made with to the present twin."""
