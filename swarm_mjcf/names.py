"""The names of a scene's MuJoCo elements: `build` writes them, `index` finds them, no one else spells them."""

GOAL = "goal"
TOP_CAMERA = "top"
TILTED_CAMERA = "tilted"
WALLS = ("wall_east", "wall_north", "wall_west", "wall_south")
AXES = ("x", "y")


def agent(i: int) -> str:
    """Body and colliding geom of agent i."""
    return f"agent{i}"


def joint(i: int, axis: str) -> str:
    """Slide joint of agent i along an axis."""
    return f"agent{i}_{axis}"


def motor(i: int, axis: str) -> str:
    """Motor of agent i along an axis; its control is an acceleration [m/s^2]."""
    return f"agent{i}_a{axis}"


def obstacle(k: int) -> str:
    """Mocap body and colliding geom of obstacle k."""
    return f"obstacle{k}"


def disc(name: str) -> str:
    """The visual-only geom of a body."""
    return f"{name}_disc"


def touch(i: int) -> str:
    """Sensor: number of contacts of agent i, with anything."""
    return f"agent{i}_touch"


def touch_of(i: int, other: str) -> str:
    """Sensor: contacts of agent i with one other geom."""
    return f"agent{i}_touch_{other}"
