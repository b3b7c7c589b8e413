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

// Columns of what blending's backward pass sums up for a splat, with sigma = -ln(alpha / opacity), g = d loss / d sigma
// and e = conic d: g, g e, g e et, and the sums over pixels of |g e|.
const G: u32 = 0;
const G_X: u32 = 1;
const G_Y: u32 = 2;
const G_XX: u32 = 3;
const G_XY: u32 = 4;
const G_YY: u32 = 5;
const ABS_X: u32 = 6;
const ABS_Y: u32 = 7;
const SUMS: u32 = 8;
// A pair has d loss / d colour besides.
const RED: u32 = 8;
const PAIR_SUMS: u32 = 11;
