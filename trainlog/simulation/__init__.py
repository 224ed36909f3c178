"""The plant, its sensors and its drivers."""
