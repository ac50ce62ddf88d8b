import numpy as np
from matplotlib.figure import Figure

from foretrace.pictures.bands import PredictionBand

PATH = np.column_stack([np.linspace(0, 0.05, 20), np.zeros(20), np.linspace(0.01, 0.03, 20)])
BAND = PredictionBand(PATH, np.full(20, 0.02))


def test_no_region_is_drawn_below_the_table():
    ax = Figure().subplots()
    drawn = BAND.draw_in_plane(ax, (0, 2), "C0")
    assert drawn[:, 1].min() == 0.0
    assert drawn[:, 1].max() > 0.049
    from_above = BAND.draw_in_plane(ax, (0, 1), "C0")
    np.testing.assert_allclose([from_above[:, 1].min(), from_above[:, 1].max()], [-0.02, 0.02], atol=1e-4)


def test_nor_over_time():
    ax = Figure().subplots()
    for column, low in ((2, 0.0), (0, -2.0)):
        BAND.draw_over_time(ax, np.arange(20.0), column, "C0")
        assert ax.collections[-1].get_paths()[0].vertices[:, 1].min() == low


def test_an_object_that_falls_off_the_table_leaves_it():
    falls = PredictionBand(PATH - [0, 0, 0.02], np.full(20, 0.02))
    drawn = falls.draw_in_plane(Figure().subplots(), (0, 2), "C0")
    assert abs(drawn[:, 1].min() + 0.01) < 1e-9
