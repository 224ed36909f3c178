"""The systems of the papers, run as they were published, and what the papers could not show."""
