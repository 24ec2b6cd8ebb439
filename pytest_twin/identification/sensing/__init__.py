"""Force-torque sensors and inertial measurement units from recordings of a moving robot."""
