"""One distribution, `stmpl`: to pip a Python package, to colcon the ROS package stmpl_ros."""

import os

from setuptools import find_packages, setup

ON_ROS_MACHINE = bool(os.environ.get("ROS_DISTRO"))  # its own rclpy and colcon-built messages are used there

REQUIRED = [  # what `stmpl demo` uses: node, devices, recorder, replay, finite elements, report
    "jaxtyping>=0.3",
    "libigl>=2.6",
    "matplotlib>=3.9",
    "mcap>=1.2",
    "mmgpy>=0.17",
    "numba>=0.60",
    "numpy>=2.0",
    "pydantic>=2.8",
    "python-fcl>=0.7.0.8",
    "rich>=13.7",
    "rosbags>=0.10",
    "ruamel.yaml>=0.18",
    "safetensors>=0.4",
    "scikit-fem>=11",
    "scipy>=1.13",
    "threadpoolctl>=3.5",
    "trimesh>=4.4",
    "tyro>=0.9",
]
ROS_WHEELS = [  # versions that resolve together: ROS 2 Jazzy as wheels for CPython 3.12
    "ros-rclpy[fastrtps]==7.1.6",
    "ros-common-interfaces==5.3.6",
    "ros-rmw-fastrtps-cpp==8.4.3",
    "stmpl-msgs==0.1.0",  # built from msg_defs/: install that folder, or a wheel of it, first
]
DRAWN = ["mapbox-earcut>=1.0", "shapely>=2.0"]  # tools that are extruded from an outline, such as letters
BODIES = ["anny>=0.6", "roma>=1.5", "torch>=2.4"]
LEARN = [*BODIES, *DRAWN, "zarr>=3.0"]
STUDIES = LEARN
SIM = ["gymnasium>=1.0", "manifold3d>=3.0", "mujoco==4.0.0"]
FMI = ["pythonfmu3>=0.3.4"]
GPU = ["warp-lang>=1.10"]
VIEW = [*DRAWN, "viser>=1.1"]
FOXGLOVE = ["foxglove-sdk>=0.30"]
CLUSTER = ["distributed>=2024.8"]
TEST_TOOLS = [
    "fmpy>=0.3.20",  # imports the unit of FMI
    "hypothesis>=6.100",
    "import-linter>=2.0",
    "meshio>=5.3",
    "playwright>=1.45",  # drives the Chromium that is installed; it downloads none by itself
    "pyright>=1.1.380",
    "pytest>=8",
    "pytest-cov>=5",
    "pytest-xdist>=3.6",
    "ruff>=0.6",
    "websockets>=13",  # a viewer of the topics, as Foxglove is one
]
EXTRAS = {  # by what people do
    "test": ["pytest>=8"],  # by this `colcon test` knows that pytest runs the tests
    "bodies": BODIES,  # other bodies and poses than the average at rest, which ships
    "learn": LEARN,  # make data, train; the method unet
    "studies": STUDIES,  # the paper's tables, chart, stability, calibration of the ladder
    "view": VIEW,  # the page in the browser
    "foxglove": FOXGLOVE,  # topics live in Foxglove
    "sim": SIM,  # robots in simulators
    "fmi": FMI,  # soft skin as a unit for simulators that import FMI 3.0
    "gpu": GPU,  # touches by kernels on a GPU
    "cluster": CLUSTER,  # data made on many machines
    "dev": [*TEST_TOOLS, *STUDIES, *VIEW, *FOXGLOVE, *SIM, *FMI, *GPU, *CLUSTER],
    # only by name: their licences ask more than ours
    "smpl": ["smplx>=0.1.28", "torch>=2.4"],  # not for commerce
    "tetgen": ["tetgen>=0.6"],  # AGPL
    "peers": ["felupe==11.3.0", "mujoco==4.0.0", "newton==1.8.0"],  # felupe: GPL; as docs/peers.md measured them
}

setup(
    # colcon and ros2 run know the package by the name in package.xml
    name="stmpl_ros" if ON_ROS_MACHINE else "stmpl",
    version="0.1.0",
    description="Real-time soft-tissue contact for robots: a contact comes in, the deformed skin goes out.",
    license="Apache-2.0",
    python_requires=">=3.12,<3.13",
    packages=find_packages(include=["stmpl_core*", "fem_tools*", "bags", "stmpl_sim*", "stmpl_ros*", "studies*"]),
    package_data={
        "studies": ["stability/truth.npz"],
        "stmpl_core": ["weights/*", "limbs/*.npz", "limbs/*.md"],
        "stmpl_ros": ["config/*.yaml", "foxglove/*.json"],
        "stmpl_sim": ["models/*.xml"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/stmpl_ros"]),
        ("share/stmpl_ros", ["package.xml"]),
        ("share/stmpl_ros/launch", ["launch/node.launch.py", "launch/demo.launch.py"]),
        ("share/stmpl_ros/config", [f"stmpl_ros/config/{name}.yaml" for name in ("stmpl", "limits", "frames")]),
    ]
    if ON_ROS_MACHINE
    else [],
    install_requires=REQUIRED + ([] if ON_ROS_MACHINE else ROS_WHEELS),
    extras_require=EXTRAS,
    **({"tests_require": ["pytest"]} if ON_ROS_MACHINE else {}),  # the same to an older colcon
    entry_points={"console_scripts": ["stmpl = stmpl_ros.cli:main"]},
)
