"""Pictures of results: matplotlib on an Agg canvas, km and km/h on the axes."""
