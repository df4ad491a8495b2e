"""Scripts that make the tables and pictures of the documents, one script each.

    default_runs        tables of default runs: docs/results.md
    few_photographs     table of runs with 20 photographs: docs/log/results.md
    photograph_widths   table of runs on photographs of several sizes: docs/results.md
    methods_table       table of all methods from a sweep: docs/log/results.md
    closeups_picture    docs/closeups_table.jpg, docs/closeups_worst.jpg
    expected_error      docs/expected_error.jpg
    api_pages           pages of the library from its docstrings

`python -m experiments.studies.SCRIPT --help` describes each. A script reads finished runs; where
their folder does not hold a run yet, it makes the run first.
"""
