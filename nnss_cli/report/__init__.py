"""Tables and figures, from what is on disk alone. Imports no torch."""
