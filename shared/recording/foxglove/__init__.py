"""Translation of messages to Foxglove schemas.

Foxglove, Lichtblick, rerun and PlotJuggler can open them.

The frames are world -> odom -> body -> camera (optical: z ahead, y down). The times are the stamps of the measurements.

    /tf              FrameTransforms  poses of odom, body and camera
    /body            Odometry         body pose in the world, with the mode and its reason
    /joints          JointStates      measured angles [rad] and torques [N m]
    /walk            sextant.Walk     numbers to plot: height, roll and pitch, voltage, temperature, slip, pace
    /robot           SceneUpdate      body, legs, feet (green if they carry load) and the support polygon
    /plan            SceneUpdate      planned footholds, the path to the goal, a planned passage
    /map             Grid             elevation [m], score, variance [m^2], evaluation [cells]; NaN where unknown
    /map/points      PointCloud       known cells of the map, with their score
    /scan            PointCloud       ground points of one depth frame
    /camera/depth    CompressedImage  near red, far blue; also /camera/color with a colour camera
    /log             Log              event log
"""
