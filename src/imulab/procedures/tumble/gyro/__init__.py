"""The gyroscopes of a tumble test.

Their bias at rest, and scale factors and misalignment from the turns between holds.
"""
