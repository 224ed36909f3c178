"""Forces between the coupled vehicles of a train."""
