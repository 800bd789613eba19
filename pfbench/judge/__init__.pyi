"""Public names of `pfbench.judge` and the modules that define them."""

from pfbench.logs.judge.judgement import judge_programs as judge_programs
from pfbench.logs.judge.pair_sentences import describe_judgement as describe_judgement
