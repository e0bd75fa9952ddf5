"""Two records of one motion, their calibration, and curves through them."""
