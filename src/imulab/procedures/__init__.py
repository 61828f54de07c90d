"""Procedures: each a folder of the same rooms, and one entry in the registry."""
