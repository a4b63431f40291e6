"""Definitions of the ROS 2 messages in use: fields only.

Comments, constants and defaults are left out.

Sources: ros2/common_interfaces and ros2/rcl_interfaces (Jazzy and later), ros2/geometry2 for tf2_msgs, ANYbotics/grid_map
(branch rolling). A test compares them with published type hashes, and with the definitions of another reader.
"""

from collections.abc import Mapping
from types import MappingProxyType

DEFINITIONS: Mapping[str, str] = MappingProxyType(
    {
        "builtin_interfaces/msg/Time": """
            int32 sec
            uint32 nanosec
        """,
        "std_msgs/msg/Header": """
            builtin_interfaces/Time stamp
            string frame_id
        """,
        "std_msgs/msg/String": """
            string data
        """,
        "std_msgs/msg/MultiArrayDimension": """
            string label
            uint32 size
            uint32 stride
        """,
        "std_msgs/msg/MultiArrayLayout": """
            MultiArrayDimension[] dim
            uint32 data_offset
        """,
        "std_msgs/msg/Float32MultiArray": """
            MultiArrayLayout layout
            float32[] data
        """,
        "geometry_msgs/msg/Vector3": """
            float64 x
            float64 y
            float64 z
        """,
        "geometry_msgs/msg/Point": """
            float64 x
            float64 y
            float64 z
        """,
        "geometry_msgs/msg/Quaternion": """
            float64 x
            float64 y
            float64 z
            float64 w
        """,
        "geometry_msgs/msg/Pose": """
            Point position
            Quaternion orientation
        """,
        "geometry_msgs/msg/PoseWithCovariance": """
            Pose pose
            float64[36] covariance
        """,
        "geometry_msgs/msg/PoseWithCovarianceStamped": """
            std_msgs/Header header
            PoseWithCovariance pose
        """,
        "geometry_msgs/msg/Transform": """
            Vector3 translation
            Quaternion rotation
        """,
        "geometry_msgs/msg/TransformStamped": """
            std_msgs/Header header
            string child_frame_id
            Transform transform
        """,
        "geometry_msgs/msg/Twist": """
            Vector3 linear
            Vector3 angular
        """,
        "geometry_msgs/msg/TwistStamped": """
            std_msgs/Header header
            Twist twist
        """,
        "geometry_msgs/msg/TwistWithCovariance": """
            Twist twist
            float64[36] covariance
        """,
        "nav_msgs/msg/Odometry": """
            std_msgs/Header header
            string child_frame_id
            geometry_msgs/PoseWithCovariance pose
            geometry_msgs/TwistWithCovariance twist
        """,
        "sensor_msgs/msg/JointState": """
            std_msgs/Header header
            string[] name
            float64[] position
            float64[] velocity
            float64[] effort
        """,
        "sensor_msgs/msg/PointField": """
            string name
            uint32 offset
            uint8 datatype
            uint32 count
        """,
        "sensor_msgs/msg/PointCloud2": """
            std_msgs/Header header
            uint32 height
            uint32 width
            PointField[] fields
            bool is_bigendian
            uint32 point_step
            uint32 row_step
            uint8[] data
            bool is_dense
        """,
        "sensor_msgs/msg/CompressedImage": """
            std_msgs/Header header
            string format
            uint8[] data
        """,
        "tf2_msgs/msg/TFMessage": """
            geometry_msgs/TransformStamped[] transforms
        """,
        "grid_map_msgs/msg/GridMapInfo": """
            float64 resolution
            float64 length_x
            float64 length_y
            geometry_msgs/Pose pose
        """,
        "grid_map_msgs/msg/GridMap": """
            std_msgs/Header header
            GridMapInfo info
            string[] layers
            string[] basic_layers
            std_msgs/Float32MultiArray[] data
            uint16 outer_start_index
            uint16 inner_start_index
        """,
    }
)
