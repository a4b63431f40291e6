"""What the wire says, in the schemas of Foxglove: one file opens in Foxglove, Lichtblick, rerun and PlotJuggler. Pure.

Frames are world -> odom -> body -> camera (optical: z ahead, y down). Times are the stamps of what was measured.

    /tf              FrameTransforms  where odom, body and camera are
    /body            Odometry         the body's pose in the world, with the mode and its reason
    /joints          JointStates      measured angles [rad], torques behind their load [N m]
    /walk            sextant.Walk     numbers to plot: height, lean, voltage, temperature, slip, pace
    /robot           SceneUpdate      body, legs, feet (green where they carry) and the support polygon
    /plan            SceneUpdate      planned footholds, the way to the goal, a passage as it was planned
    /map             Grid             elevation [m], score, variance [m^2], evaluation [cells]; NaN where nothing is known
    /map/points      PointCloud       the known cells where they are, with their score
    /scan            PointCloud       what one picture showed of the ground
    /camera/depth    CompressedImage  near red, far blue; and /camera/color, where there is one
    /log             Log              what has come about, in words
"""
