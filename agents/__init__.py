"""Agents: who decides, on the belief alone, where the robot goes."""
