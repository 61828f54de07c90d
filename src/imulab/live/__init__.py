"""A guided test while the unit is connected: sources, formats of streams, the session and its recording."""
