"""The C core's Python face: settings and tables of a unit as bytes, blobs and streams."""
