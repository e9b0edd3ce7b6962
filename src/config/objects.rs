//! Settings of where objects are.

use clap::Args;

use crate::storage::BucketSettings;

/// Where signals, weights and reports are stored.
#[derive(Debug, Clone, Args)]
pub struct ObjectArgs {
    /// Bucket and prefix for the objects, as `s3://bucket/prefix` [default: the data directory]. Keys come from
    /// `AWS_ACCESS_KEY_ID` and `AWS_SECRET_ACCESS_KEY`.
    #[arg(long = "objects", env = "RIGCAST_OBJECTS")]
    pub url: Option<String>,

    /// Address of the S3-compatible storage, such as `http://127.0.0.1:9000` [default: that of AWS].
    #[arg(long, env = "RIGCAST_S3_ENDPOINT")]
    pub s3_endpoint: Option<String>,

    /// Region of the bucket [default: `AWS_REGION`, or us-east-1].
    #[arg(long, env = "RIGCAST_S3_REGION")]
    pub s3_region: Option<String>,

    /// The storage wants the bucket's name in the host, not in the path.
    #[arg(long, env = "RIGCAST_S3_VIRTUAL_HOSTED")]
    pub s3_virtual_hosted: bool,

    /// Bytes of objects of a bucket that the data directory keeps copies of; those not used for the longest time go.
    #[arg(long, env = "RIGCAST_OBJECTS_CACHE_BYTES", default_value_t = 20 << 30)]
    pub objects_cache_bytes: u64,
}

impl ObjectArgs {
    /// The bucket, if one is named.
    pub fn bucket(&self) -> Option<BucketSettings> {
        let url = self.url.clone().filter(|url| !url.is_empty())?;
        Some(BucketSettings {
            url,
            endpoint: self.s3_endpoint.clone(),
            region: self.s3_region.clone(),
            virtual_hosted: self.s3_virtual_hosted,
            cache_bytes: self.objects_cache_bytes,
        })
    }
}
