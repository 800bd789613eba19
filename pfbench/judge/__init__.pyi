"""Public names of `pfbench.judge` and the modules that define them."""

from pfbench.judge.block_decisions import describe_blocks as describe_blocks
from pfbench.judge.judgement import judge_programs as judge_programs
