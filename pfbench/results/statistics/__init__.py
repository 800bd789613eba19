"""Statistics of paired samples: tests, effect sizes, intervals and sample sizes."""
