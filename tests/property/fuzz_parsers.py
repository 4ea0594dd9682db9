"""The long run of the fuzzers: millions of inputs, guided by coverage, one process a parser, all counted.

    pip install atheris
    nice -n 10 python tests/property/fuzz_parsers.py --executions 10000000

Inputs that reach new code are kept in --corpus, so that the next run begins where this one ended. The first
input that ends in anything but an error of the tree stops the run and is written to crash-PARSER-*.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

INSTRUMENTED = ["tagid.radar", "tagid.storage"]
_TOO_SLOW_S = 20
_RSS_MB = 1024


def fuzz_one(name: str, runs: int, corpus: Path) -> None:
    """Fuzz one target in this process until `runs` executions are done; libFuzzer ends the process."""
    import atheris

    with atheris.instrument_imports(include=INSTRUMENTED):
        from fuzz_targets import TARGETS
    target = next(target for target in TARGETS if target.name == name)
    corpus.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(target.seeds()):
        (corpus / f"seed-{number}").write_bytes(seed)
    options = [f"-runs={runs}", f"-max_len={target.longest}", f"-timeout={_TOO_SLOW_S}", "-len_control=0",
               f"-rss_limit_mb={_RSS_MB}", f"-artifact_prefix=crash-{name}-", "-seed=1"]  # fmt: skip
    atheris.Setup([sys.argv[0], *options, str(corpus)], target.run)
    atheris.Fuzz()


def main() -> int:
    """Run every target for its share; prints a line a target and the sum."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--executions", type=int, default=10_000_000, help="of all parsers together")
    parser.add_argument("--parser", help="only this one")
    parser.add_argument("--corpus", type=Path, default=Path(".fuzz-corpus"))
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.here:
        fuzz_one(options.parser, options.executions, options.corpus)
        return 0
    from fuzz_targets import TARGETS

    total, began = 0, time.monotonic()
    for target in TARGETS:
        if options.parser not in (None, target.name):
            continue
        runs = options.executions if options.parser else round(options.executions * target.share)
        words = [sys.executable, __file__, "--here", "--parser", target.name, "--executions", str(runs),
                 "--corpus", str(options.corpus / target.name)]  # fmt: skip
        done = subprocess.run(words, capture_output=True, text=True, errors="replace")
        match = re.search(r"Done (\d+) runs in (\d+) second", done.stderr)
        if done.returncode or not match:
            sys.stdout.write(f"{target.name}: FAULT (exit {done.returncode})\n{done.stderr[-4000:]}\n")
            return 1
        total += int(match[1])
        covered = re.findall(r"ft: (\d+)", done.stderr)
        sys.stdout.write(
            f"{target.name:<14}{int(match[1]):>12} executions, {match[2]:>6} s, "
            f"{covered[-1]:>6} features, no fault\n"
        )
        sys.stdout.flush()
    sys.stdout.write(f"{'together':<14}{total:>12} executions, {time.monotonic() - began:>6.0f} s\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
