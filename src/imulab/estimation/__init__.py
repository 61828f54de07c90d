"""What is inferred from numbers whatever the procedure: least squares, noise, sampling, rows to leave out."""
