"""Files of the sky: broadcast orbits, RINEX, and the receiver of raw ranges."""
