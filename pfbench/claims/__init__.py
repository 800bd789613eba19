"""Claims of the papers: records, measurements, verdicts and their page."""
