#!/usr/bin/env bash
# RViz shows an exported ROS 1 bag with the configuration beside it, on a screen that exists in memory only.
# Needs Debian's packages: rviz ros-base xvfb xauth imagemagick
#
#   foretrace export rosbag --data data/paper --ids 12 --run runs/im-cnn --ros 1 --out bags
#   docs/images/rviz.sh bags/interaction-000012.bag docs/images/rviz.png
set -euo pipefail
bag=$(realpath "$1") picture=$(realpath -m "$2")
config=$(dirname "$bag")/foretrace.rviz
work=$(mktemp -d)
started=()
finish() { kill "${started[@]}" 2>/dev/null || true; wait 2>/dev/null || true; rm -rf "$work"; }
trap finish EXIT
export ROS_MASTER_URI=http://127.0.0.1:11987 ROS_IP=127.0.0.1 ROS_HOME=$work ROS_LOG_DIR=$work HOME=$work
export LIBGL_ALWAYS_SOFTWARE=1 QT_X11_NO_MITSHM=1 XDG_RUNTIME_DIR=$work DISPLAY=:87 PYTHONPATH=

Xvfb "$DISPLAY" -screen 0 1400x860x24 +extension GLX >"$work/xvfb" 2>&1 & started+=($!)
rosmaster --core -p 11987 >"$work/master" 2>&1 & started+=($!)
until rosparam set use_sim_time true 2>"$work/rosparam"; do sleep 1; done
rviz -d "$config" >"$work/rviz" 2>&1 & started+=($!)
until rosnode list 2>/dev/null | grep --quiet rviz; do sleep 1; done
sleep 10 # it subscribes, and draws for the first time
rosbag play --clock --quiet --delay 2 "$bag" </dev/null >"$work/play" 2>&1
sleep 5
import -window root "$picture"
