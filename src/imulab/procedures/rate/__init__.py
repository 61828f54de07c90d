"""Gyroscopes on a rate table and by whole turns: bias, scale factor, misalignment and what a line leaves."""
