"""The project's own file formats, and those of others that become ours."""
