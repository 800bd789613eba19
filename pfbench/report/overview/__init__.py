"""First page of a study of proposed methods in several worlds: each against the best conventional filter, and all pairs."""
