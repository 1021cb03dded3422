"""Estimators: what the robot believes, from odometry, scans and landmark observations."""
