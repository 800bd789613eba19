"""Paper export of a study: figures, tables, methods paragraph and a paper that compiles."""
