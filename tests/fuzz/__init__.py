"""Mutated input files: each must give an answer or a refusal with a reason, within limits of time and memory.

`python -m tests.fuzz --runs 10000 --seed 1` in the root of the repository prints what came out, by kind of input.
`seeds.py` makes valid files, `mutate.py` changes them, `targets.py` reads them and judges the outcome, `commands.py`
does so with whole commands and what they go on from, `access.py` sees which files a read touches, `campaign.py` runs
many of them in a process with limits, and `guided.py` lets a coverage-guided fuzzer choose the changes.
"""
