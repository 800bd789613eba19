"""Public names of `pfbench.judge` and the modules that define them."""

from pfbench.judge.judgement import (
    describe_blocks as describe_blocks,
    judge_programs as judge_programs,
)
