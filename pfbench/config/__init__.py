"""Configuration of jobs: composition, trust, and keys that files may not set."""
