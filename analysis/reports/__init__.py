"""Results as a page or a few lines: what a file or a folder of results holds."""
