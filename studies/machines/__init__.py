"""Virtual machines that only a study drives; like ``dtwin.machines``, they know nothing of what fits."""
