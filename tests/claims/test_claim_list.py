"""The 88 claims of the papers as data: ids, kinds, factors with readings, proofs, and where a decision turns."""

from collections import Counter
from functools import cache

from config_cases import GROUPS

from pfbench.claims.claim_lines import read_proofs
from pfbench.claims.claim_list import (
    KINDS,
    read_printed_claims,
)
from pfbench.job.readings import read_reading_table

CLAIMS = read_printed_claims()


@cache
def list_factors(paper: str) -> set[str]:
    return {row["factor"] for row in read_reading_table(paper).values()} - {"none"}


def test_there_are_88_claims() -> None:
    assert len(CLAIMS) == 88
    counts = Counter(claim.paper for claim in CLAIMS)
    assert counts == {"000": 10, "001": 12, "002": 40, "003": 11, "004": 15}


def test_each_claim_names_what_exists() -> None:
    proofs = {proof.id: proof for proof in read_proofs()}
    for claim in CLAIMS:
        assert claim.a in {*GROUPS["filter"], "each"}, claim.id
        assert len(claim.words) > 12, claim.id
        assert claim.section, claim.id
        assert set(claim.factors) <= list_factors(claim.paper), claim.id
        assert not claim.proof or claim.id in proofs[claim.proof].claims, claim.id
        assert (claim.kind == "number") <= bool(claim.printed or claim.mark.startswith("lost")), (
            claim.id
        )
    named = {claim for proof in proofs.values() for claim in proof.claims}
    assert named <= {claim.id for claim in CLAIMS}
    assert {claim.id for claim in CLAIMS if claim.proof} == named


def test_each_factor_of_a_paper_touches_a_claim() -> None:
    for paper in ("000", "001", "002", "003", "004"):
        touched = {factor for claim in CLAIMS if claim.paper == paper for factor in claim.factors}
        assert list_factors(paper) <= touched


def test_claims_have_a_kind_a_known_mark_and_a_name_of_their_own() -> None:
    assert len({claim.id for claim in CLAIMS}) == len(CLAIMS)
    assert {claim.kind for claim in CLAIMS} == set(KINDS)
    assert {claim.mark.split(":")[0] for claim in CLAIMS} <= {"circular", "vacuous", "lost", ""}
