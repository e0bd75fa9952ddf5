"""Stages, their actuators, sensors and vibration, and the microscope over them."""
