"""Table that a study returns."""

import pandas as pd


class Table(pd.DataFrame):
    """Rows of a study as a pandas.DataFrame, one per run.

    `attrs["folder"]` is the folder of the runs where there is one.
    """
