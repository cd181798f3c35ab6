"""The parts of `benchmarks/guard.py`.

Each part is a module with ``TASKS``, functions by name that return `metrics.Metric`s. `running`
does them in processes and keeps what is done, `metrics` compares them with a baseline. Parts call
the product by the names that `telerig` exports, its commands and its files; what else they need of
it stands in `product`.
"""
