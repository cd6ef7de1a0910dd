"""Linear identification in NumPy and SciPy."""
