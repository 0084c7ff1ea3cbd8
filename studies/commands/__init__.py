"""The commands that start a study; ``dtwin.commands`` finds them here by their place."""
