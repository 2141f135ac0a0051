"""Programs around sonar_gl: benches, the chart of time against error, pictures and tables of the docs.

Each runs as a module from the repository root: `python -m tools.bench`, `python -m tools.chart`,
`python -m tools.promise`, `python -m tools.docs.gallery`. tools/setup.sh, tools/demo and tools/test are shell
scripts.
"""
