"""Public names of `pfbench.claims` and the modules that define them."""

from pfbench.claims.claim_records import read_claims as read_claims
