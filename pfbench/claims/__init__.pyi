"""Public names of `pfbench.claims` and the modules that define them."""

from pfbench.claims.claim_list import read_printed_claims as read_printed_claims
from pfbench.claims.claim_records import read_claims as read_claims
from pfbench.claims.proofs import read_proofs as read_proofs
