"""Pictures in a terminal: which way it knows, and what is sent."""

import io
import re
from base64 import b64decode

import numpy as np
import pytest
from PIL import Image

from sfm_app.cli.ending.graphics import Graphics, crop, draw, graphics_of

COLORFUL = {"TERM": "xterm-256color", "COLORTERM": "truecolor"}


class Screen(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        (COLORFUL, Graphics.BLOCKS),
        ({"TERM": "xterm-direct"}, Graphics.BLOCKS),
        ({**COLORFUL, "NO_COLOR": ""}, None),
        ({"TERM": "xterm-256color"}, None),
        ({"TERM": "dumb", "COLORTERM": "truecolor", "KITTY_WINDOW_ID": "1"}, None),
        ({"COLORTERM": "truecolor"}, None),
        ({"TERM": "xterm-kitty"}, Graphics.KITTY),
        ({"TERM": "xterm-256color", "KITTY_WINDOW_ID": "1", "NO_COLOR": "1"}, Graphics.KITTY),
        ({**COLORFUL, "TERM_PROGRAM": "ghostty"}, Graphics.KITTY),
        ({**COLORFUL, "TERM_PROGRAM": "iTerm.app"}, Graphics.ITERM),
        ({**COLORFUL, "LC_TERMINAL": "iTerm2"}, Graphics.ITERM),
        ({"WT_SESSION": "1"}, Graphics.BLOCKS),
        ({"TERM": "foot"}, Graphics.SIXEL),
        ({"TERM": "xterm-sixel"}, Graphics.SIXEL),
        (
            {"TERM": "tmux-256color", "COLORTERM": "truecolor", "KITTY_WINDOW_ID": "1", "TMUX": "1"},
            Graphics.BLOCKS,
        ),
        ({"TERM": "screen", "KITTY_WINDOW_ID": "1"}, None),
    ],
)
def test_a_terminal_tells_by_its_variables_what_it_knows(environment, expected):
    assert graphics_of(Screen(), environment) is expected
    assert graphics_of(io.StringIO(), environment) is None


@pytest.fixture
def picture():
    """Red above blue, 40 wide and 20 high, on nothing."""
    made = np.zeros((60, 80, 4), np.uint8)
    made[20:30, 10:50] = (255, 0, 0, 255)
    made[30:40, 10:50] = (0, 0, 255, 255)
    return made


def test_what_surrounds_the_model_is_left_out(picture):
    assert crop(picture).shape == (20, 40, 4)
    assert crop(np.zeros((4, 5, 4), np.uint8)).shape == (4, 5, 4)


def test_half_blocks_show_two_pixels_each(picture):
    text = draw(picture, Graphics.BLOCKS, 5, 40)

    lines = text.splitlines()
    assert [re.sub(r"\x1b\[[0-9;]*m", "", line) for line in lines] == ["  " + 20 * "▀"] * 5
    assert lines[0] == f"  \x1b[0;38;2;255;0;0;48;2;255;0;0m{20 * '▀'}\x1b[0m"
    assert lines[2] == f"  \x1b[0;38;2;255;0;0;48;2;0;0;255m{20 * '▀'}\x1b[0m"
    assert all(line.endswith("\x1b[0m") for line in lines) and text.endswith("\n")


def test_half_blocks_leave_out_what_is_transparent():
    corner = np.zeros((4, 4, 4), np.uint8)
    corner[:3, 0] = corner[0, :3] = corner[3, 3] = (9, 8, 7, 255)

    lines = draw(corner, Graphics.BLOCKS, 2, 4).splitlines()
    assert [re.sub(r"\x1b\[[0-9;]*m", "", line) for line in lines] == ["  ▀▀▀", "  ▀  ▄"]
    assert "48;2" in lines[0] and "48;2" not in lines[1]


@pytest.mark.parametrize(("rows", "columns", "size"), [(10, 100, (10, 40)), (100, 20, (5, 20))])
def test_a_picture_keeps_its_shape_in_cells_twice_as_high_as_wide(picture, rows, columns, size):
    lines = draw(picture, Graphics.BLOCKS, rows, columns).splitlines()
    assert (len(lines), lines[0].count("▀")) == size
    assert f"c={size[1]},r={size[0]}," in draw(picture, Graphics.KITTY, rows, columns)
    assert f"width={size[1]};height={size[0]};" in draw(picture, Graphics.ITERM, rows, columns)


def test_kitty_gets_a_png_in_parts_and_does_not_answer():
    noise = np.random.default_rng(0).integers(0, 256, (50, 60, 4), np.uint8)
    noise[..., 3] = 255

    parts = re.findall(r"\x1b_G([^;]*);([^\x1b]*)\x1b\\", draw(noise, Graphics.KITTY, 10, 40))
    heads, data = zip(*parts, strict=True)
    assert len(parts) > 2 and max(map(len, data)) == 4096
    assert heads[0].startswith("a=T,f=100,q=2,") and heads[0].endswith("m=1")
    assert set(heads[1:-1]) == {"m=1"} and heads[-1] == "m=0"
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(b64decode("".join(data))))), noise)


def test_iterm_gets_a_png(picture):
    sent = re.fullmatch(r"\x1b\]1337;File=inline=1;[^:]*:(.*)\x07\n", draw(picture, Graphics.ITERM, 10, 40))
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(b64decode(sent[1])))), crop(picture))


def decode_sixels(text):
    """What a terminal draws: (H, W, 3) in percent, -1 where nothing is."""
    size, body = re.fullmatch(r'\x1bP0;1;0q"1;1;(\d+;\d+)(.*)\x1b\\\n', text, re.DOTALL).groups()
    width, height = map(int, size.split(";"))
    drawn, palette, color, x, y = np.full((height + 6, width, 3), -1), {}, 0, 0, 0
    for part in re.findall(r"#\d+;2;\d+;\d+;\d+|#\d+|!\d+[?-~]|[?-~]|\$|-", body):
        if part[0] == "#":
            color, *shade = [int(value) for value in part[1:].split(";")]
            if shade:
                palette[color] = shade[1:]
        elif part == "$":
            x = 0
        elif part == "-":
            x, y = 0, y + 6
        else:
            count = int(part[1:-1]) if part[0] == "!" else 1
            for bit in range(6):
                if (ord(part[-1]) - 63) >> bit & 1:
                    drawn[y + bit, x : x + count] = palette[color]
            x += count
    return drawn[:height]


def test_sixels_draw_the_picture(picture):
    picture[20:30, 10:30] = 0
    drawn = decode_sixels(draw(picture, Graphics.SIXEL, 2, 80))

    assert drawn.shape == (40, 80, 3)
    assert (drawn[2:18, 2:38] == -1).all()
    assert (drawn[2:18, 42:] == (100, 0, 0)).all() and (drawn[22:, 2:] == (0, 0, 100)).all()
