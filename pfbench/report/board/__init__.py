"""Board of a study: what a report shows, decided once."""
