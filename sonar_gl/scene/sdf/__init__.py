"""Reader of SDF, the scene format of Gazebo, and of URDF and xacro, the robot formats of ROS.

The flow of `reader.read_sdf`:

1. Files: `resources.Resources` finds the files that a scene names, in its folder and the resource paths, and
   parses their XML. `xacro.expand` expands macros; `urdf.model_of` converts a robot to SDF.
2. Tree: `reader.TreeReader` makes a tree of `frames.Scope` from the world, its models and includes. A scope
   resolves the poses of its frames.
3. Links: `links.links_of` lists the links of the tree; `sensors.find_sonars` finds those with a sonar, and
   `sensors.read_sensor` what their tags state of it.
4. Shapes: `shapes.BodyReader` reads the collisions or visuals of a link, with their surface properties.
5. Bodies: shapes of one link with the same specular lobe are joined into one `Body`.

`extensions` reads the elements of namespace `sonar_gl`, such as bubble plumes and the water's surface.
"""
