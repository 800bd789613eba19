"""Public names of `pfbench.claims` and the modules that define them."""

from pfbench.claims.claim_lines import read_proofs as read_proofs
from pfbench.claims.claim_list import KINDS as KINDS, read_printed_claims as read_printed_claims
from pfbench.claims.page import write_claims as write_claims
from pfbench.claims.words import (
    ClaimDecision as ClaimDecision,
    ClaimSample as ClaimSample,
    ReadingDot as ReadingDot,
    decide_claim as decide_claim,
    weigh as weigh,
)
