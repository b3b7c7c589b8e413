// What all shaders share.

const LANES: u32 = 64;
const TILE: u32 = 16;

// A splat as an ellipse on the image: log2 alpha = log2_opacity - LOG2_E / 2 (d . conic d), d from the mean.
struct Row {
    mean: vec2f,  // in pixels
    half_size: vec2f,  // of the box around the ellipse on which alpha is ALPHA_MIN
    conic: vec3f,  // xx, xy and yy of the inverse covariance
    log2_opacity: f32,
    depth: f32,  // along the camera's z axis
    radius: f32,  // three standard deviations along the longest axis; 0: it is not drawn
}

// Which workgroup it is: they lie along two dimensions where one is too short for them.
fn group_of(group: vec3u, groups: vec3u) -> u32 {
    return group.x + group.y * groups.x;
}
