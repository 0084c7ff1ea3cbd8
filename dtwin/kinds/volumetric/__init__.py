"""Ball arrays: the record of the kind."""
