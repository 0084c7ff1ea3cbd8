"""Signal features, alignment of streams, and path inputs; the same code trains and serves."""

__all__ = ["alignment", "catalogue", "path_inputs", "windows"]
