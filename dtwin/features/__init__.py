"""Signal features, alignment of streams, and path inputs; the same code trains and serves."""
