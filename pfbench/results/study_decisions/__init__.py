"""Parts of a study's decisions: metrics of the main group, consistency, common conditions and cost."""
