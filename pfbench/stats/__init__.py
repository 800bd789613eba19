"""Statistics of studies: effects of pairs, levels, tests of families, dependence, planned looks."""
