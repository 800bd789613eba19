"""Chart blocks of matrix Lie groups."""
