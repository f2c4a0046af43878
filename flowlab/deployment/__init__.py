"""Trained policies in use: on a robot, or in an evaluation."""
